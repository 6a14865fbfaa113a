"""The ground station as a service: its processes, their bus, and its page."""
