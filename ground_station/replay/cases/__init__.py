"""Replay tests as data: what a case is, what a run leaves behind, how it is judged and compared."""
