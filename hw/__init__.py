"""The payload's hardware as data, and what follows from it: lift, margin, balance, endurance."""
