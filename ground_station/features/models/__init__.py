"""Networks that ship, as ONNX: read by `catalogue`."""
