"""Labels on their way to an editor and back: which are asked about, what comes of the answer."""
