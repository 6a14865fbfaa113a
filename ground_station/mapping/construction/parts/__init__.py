"""Structure from motion in overlapping parts: cut, made beside each other, joined and united."""
