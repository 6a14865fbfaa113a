"""The small authority of the ground station: certificates and keys, and who may use them."""
