"""The web process: dashboard, HTTP API, live channel and metrics of the ground station service."""
