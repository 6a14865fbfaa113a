"""How the product shows itself: pages, pictures and tables in one theme."""
