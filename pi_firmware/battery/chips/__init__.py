"""Gauges on I2C, a file each: found by the chips that it declares in `CHIPS`."""
