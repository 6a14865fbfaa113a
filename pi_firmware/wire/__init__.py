"""All that payload and ground station must agree on: keys, messages, layouts, ports, recordings."""
