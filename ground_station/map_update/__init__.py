"""Maps that change after they were built: flights extend them."""
