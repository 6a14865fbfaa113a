"""`blimp doctor`: what the ground station needs of its machine, and how to mend what is not so."""
