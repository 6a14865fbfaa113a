"""A smaller map that localizes nearly as well."""
