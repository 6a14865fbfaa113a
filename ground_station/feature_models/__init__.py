"""Weights that a user brings, as models of the product: read without torch, written as ONNX."""
