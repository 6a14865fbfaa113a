"""`blimp replay`: a recording flies again through the payload's firmware and the ground station."""
