"""`blimp bench`: what the localizer, the payload, the features and the maps cost, and how good."""
