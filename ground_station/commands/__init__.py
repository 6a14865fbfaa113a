"""Commands of `blimp` whose sub-commands come from several rooms."""
