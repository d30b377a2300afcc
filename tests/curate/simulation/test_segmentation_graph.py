"""The segmentation network's ONNX graph agrees with the network."""

import numpy as np
import onnxruntime
import torch

from curate.simulation.segmentation import SegmentationNet
from curate.simulation.segmentation_graph import build_graph


def lively() -> SegmentationNet:
    """Return a network with batch norms far from their initial values."""
    generator = torch.Generator().manual_seed(0)
    net = SegmentationNet().eval()
    with torch.no_grad():
        for module in net.modules():
            if isinstance(module, torch.nn.BatchNorm2d):
                module.running_mean.uniform_(-0.3, 0.3, generator=generator)
                module.running_var.uniform_(0.3, 1.5, generator=generator)
                module.weight.uniform_(0.5, 1.5, generator=generator)
                module.bias.uniform_(-0.2, 0.2, generator=generator)
            elif isinstance(module, torch.nn.Conv2d):
                shape = module.weight[0].numel()
                module.weight.normal_(0, (2 / shape) ** 0.5, generator=generator)
        net.head.bias.zero_()
    return net


def test_onnx_runtime_and_torch_predict_the_same_classes():
    """For an image of odd height and width; only ties may differ."""
    net, (width, height) = lively(), (53, 37)
    image = np.random.default_rng(0).integers(0, 255, (1, height, width, 3), dtype=np.uint8)
    with torch.no_grad():
        expected = net(torch.from_numpy(image)).argmax(dim=1).numpy()
    weights = {name: tensor.numpy() for name, tensor in net.state_dict().items()}
    model = build_graph(weights, width, height).SerializeToString()
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    (found,) = session.run(["class_ids"], {"image": image})
    assert (found.shape, found.dtype) == ((1, height, width), np.uint8)
    assert len(np.unique(expected)) > 2
    assert (found == expected).mean() > 0.998
