"""One module a reader: `fuzz(data)`, which lets only documented refusals pass, and `seeds()`."""
