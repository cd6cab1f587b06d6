"""Window -> image: the methods that FireNet is measured against, each as the body of a scan."""
