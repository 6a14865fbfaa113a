"""Ground stations side by side: who is there, what each tells, and who takes which payload."""
