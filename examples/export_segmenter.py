"""Export a semantic or instance segmentation model to ONNX, for `curate init --segmenter`.

    python export_segmenter.py deeplab deeplab.onnx          # torchvision's DeepLab v3
    python export_segmenter.py segformer cityscapes.onnx     # SegFormer, trained on Cityscapes
    python export_segmenter.py yolo yolo11n-seg.onnx         # YOLO, instances

Each needs its own library (torchvision, transformers, ultralytics), and fetches the published
weights on its first run; `--weights` takes a file or folder of your own instead. Semantic models
need onnxscript as well. The last line that the script prints has the options for `curate init`.
"""

import argparse
import sys
from pathlib import Path

import torch
from torch import nn
from torch.nn import functional


class ClassIds(nn.Module):
    """A semantic model whose output is the class id of each pixel, uint8 [1, height, width].

    Class ids instead of scores keep the output small: one byte per pixel instead of 4 per class.
    """

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the class ids of an image, float32 [1, 3, height, width]."""
        output = self.model(image)
        # torchvision returns a dictionary with "out", transformers one with "logits".
        scores = output if isinstance(output, torch.Tensor) else output.get("out")
        if scores is None:
            scores = output["logits"]
        if scores.shape[-2:] != image.shape[-2:]:
            scores = functional.interpolate(scores, image.shape[-2:], mode="bilinear")
        return scores.argmax(dim=1).to(torch.uint8)


def export_semantic(model: nn.Module, path: Path, height: int, width: int) -> None:
    """Write a semantic model as ONNX that takes images of one size, scaled as for ImageNet."""
    image = torch.zeros(1, 3, height, width)
    torch.onnx.export(
        ClassIds(model).eval(),
        (image,),
        str(path),
        input_names=["image"],
        output_names=["class_ids"],
        dynamo=True,
        external_data=False,
    )


def deeplab(weights: Path | None) -> nn.Module:
    """Return torchvision's DeepLab v3 with MobileNet v3; its classes are those of Pascal VOC."""
    from torchvision.models.segmentation import deeplabv3_mobilenet_v3_large

    if weights is None:
        return deeplabv3_mobilenet_v3_large(weights="DEFAULT")
    model = deeplabv3_mobilenet_v3_large(weights=None, weights_backbone=None, aux_loss=True)
    model.load_state_dict(torch.load(weights, weights_only=True))
    return model


def segformer(weights: Path | None) -> nn.Module:
    """Return SegFormer B0; its classes are the train ids of Cityscapes."""
    from transformers import SegformerForSemanticSegmentation

    name = weights or "nvidia/segformer-b0-finetuned-cityscapes-1024-1024"
    model = SegformerForSemanticSegmentation.from_pretrained(name)
    model.config.return_dict = True
    return model


def export_yolo(weights: Path | None, path: Path, height: int, width: int) -> None:
    """Write a YOLO segmentation model as ONNX, with its outputs before non-maximum suppression."""
    from ultralytics import YOLO

    written = YOLO(weights or "yolo11n-seg.pt").export(format="onnx", imgsz=(height, width))
    Path(written).replace(path)


def main(arguments: list[str] | None = None) -> None:
    """Export the requested model and print the options that `curate init` needs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", choices=["deeplab", "segformer", "yolo"])
    parser.add_argument("output", type=Path, help="the .onnx file to write")
    parser.add_argument("--weights", type=Path, help="your own weights instead of the published")
    parser.add_argument("--height", type=int, default=384, help="of the image, a multiple of 32")
    parser.add_argument("--width", type=int, default=1248, help="of the image, a multiple of 32")
    given = parser.parse_args(arguments)
    options = f"--segmenter-path {given.output}"
    if given.model == "yolo":
        export_yolo(given.weights, given.output, given.height, given.width)
        options = f"--segmenter onnx-instances {options} --segmenter-classes coco-from-0"
        outputs = '{predictions="output0", prototypes="output1"}'
        options += f" --set 'segmenter.options.outputs={outputs}'"
    else:
        model = {"deeplab": deeplab, "segformer": segformer}[given.model](given.weights)
        export_semantic(model, given.output, given.height, given.width)
        classes = {"deeplab": "voc", "segformer": "cityscapes"}[given.model]
        options = f"--segmenter onnx {options} --segmenter-classes {classes}"
    sys.stdout.write(f"curate init WORKSPACE --root ROOT {options}\n")


if __name__ == "__main__":
    main()
