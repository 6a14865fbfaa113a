"""What runs on the payload: camera, gate, encoder, stream, battery and telemetry."""

__version__ = "0.2.0"
