"""The RTP receiver and the clock between payload and ground."""
