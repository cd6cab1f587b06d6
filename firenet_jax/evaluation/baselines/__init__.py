"""Window -> image: the methods that FireNet is measured against."""
