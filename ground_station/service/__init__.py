"""The ground station as a service, its processes and its page; replay, demo and the benches."""
