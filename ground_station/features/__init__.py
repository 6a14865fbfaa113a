"""Key points with descriptors, by any extractor."""
