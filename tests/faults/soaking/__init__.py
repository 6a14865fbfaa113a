"""What long runs have in common: sampling, trends, judgement, pictures. No test is in here."""
