"""Names of the options of ONNX Runtime's execution providers, as of version 1.32.

Some providers ignore options that they do not have, others fail when they load a model.
"""

from collections.abc import Mapping
from typing import Final

_STREAM = ("device_id", "has_user_compute_stream", "user_compute_stream")

KNOWN_OPTIONS: Final[Mapping[str, tuple[str, ...]]] = {
    "cpu": (),
    "cuda": (
        *_STREAM, "gpu_mem_limit", "arena_extend_strategy", "cudnn_conv_algo_search",
        "do_copy_in_default_stream", "gpu_external_alloc", "gpu_external_free",
        "gpu_external_empty_cache", "cudnn_conv_use_max_workspace", "enable_cuda_graph",
        "cudnn_conv1d_pad_to_nc1d", "tunable_op_enable", "tunable_op_tuning_enable",
        "tunable_op_max_tuning_duration_ms", "enable_skip_layer_norm_strict_mode", "prefer_nhwc",
        "use_ep_level_unified_stream", "use_tf32", "sdpa_kernel", "fuse_conv_bias",
    ),
    "tensorrt": (
        *_STREAM, "trt_max_partition_iterations", "trt_min_subgraph_size", "trt_max_workspace_size",
        "trt_fp16_enable", "trt_bf16_enable", "trt_int8_enable", "trt_int8_calibration_table_name",
        "trt_int8_use_native_calibration_table", "trt_dla_enable", "trt_dla_core",
        "trt_dump_subgraphs", "trt_engine_cache_enable", "trt_engine_cache_path",
        "trt_engine_cache_prefix", "trt_weight_stripped_engine_enable",
        "trt_onnx_model_folder_path", "trt_engine_decryption_enable",
        "trt_engine_decryption_lib_path", "trt_force_sequential_engine_build",
        "trt_context_memory_sharing_enable", "trt_layer_norm_fp32_fallback",
        "trt_timing_cache_enable", "trt_timing_cache_path", "trt_force_timing_cache",
        "trt_detailed_build_log", "trt_build_heuristics_enable", "trt_sparsity_enable",
        "trt_builder_optimization_level", "trt_auxiliary_streams", "trt_tactic_sources",
        "trt_extra_plugin_lib_paths", "trt_profile_min_shapes", "trt_profile_max_shapes",
        "trt_profile_opt_shapes", "trt_cuda_graph_enable", "trt_preview_features",
        "trt_ep_context_embed_mode", "trt_ep_context_file_path", "trt_dump_ep_context_model",
        "trt_engine_hw_compatible", "trt_onnx_bytestream", "trt_onnx_bytestream_size",
        "trt_external_data_bytestream", "trt_external_data_bytestream_size",
        "trt_op_types_to_exclude", "trt_load_user_initializer",
    ),
    "migraphx": (
        *_STREAM, "migraphx_fp16_enable", "migraphx_bf16_enable", "migraphx_fp8_enable",
        "migraphx_int8_enable", "migraphx_int8_calibration_table_name",
        "migraphx_int8_use_native_calibration_table", "migraphx_model_cache_dir",
        "migraphx_exhaustive_tune", "migraphx_mem_limit", "migraphx_arena_extend_strategy",
        "migraphx_external_alloc", "migraphx_external_free", "migraphx_external_empty_cache",
        "migraphx_max_dynamic_batch",
    ),
    "directml": (
        "device_id", "performance_preference", "device_filter", "disable_metacommands",
        "enable_graph_capture", "enable_graph_serialization", "enable_dynamic_graph_fusion",
    ),
    "openvino": (
        "device_type", "device_id", "device_luid", "cache_dir", "precision", "load_config",
        "context", "num_of_threads", "model_priority", "num_streams", "enable_opencl_throttling",
        "enable_qdq_optimizer", "enable_causallm", "disable_dynamic_shapes", "reshape_input",
        "layout",
    ),
    "coreml": (
        "MLComputeUnits", "ModelFormat", "RequireStaticInputShapes", "EnableOnSubgraphs",
        "SpecializationStrategy", "ProfileComputePlan", "AllowLowPrecisionAccumulationOnGPU",
        "ModelCacheDirectory",
    ),
}  # fmt: skip
"""The options by the name of the provider in settings; a provider that is missing has others."""
