"""The ground station's ends of the payload's streams: video over RTP, telemetry over Zenoh."""
