"""How good features are: `blimp bench features`."""
