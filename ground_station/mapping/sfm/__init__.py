"""Structure from motion by COLMAP: its database, its mappers, its adjustment; models of others."""
