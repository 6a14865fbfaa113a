"""How our own network is made: its pictures, its labels, its training. Torch only for the last."""
