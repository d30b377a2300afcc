"""Reading and writing files safely: atomic writes, TOML, Parquet, ONNX models."""
