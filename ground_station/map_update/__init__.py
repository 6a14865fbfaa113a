"""Maps that change after they were built: flights extend them, compression makes them smaller."""
