"""Tools that any room may use: files, caches, threads, kernels, figures. They know nothing of parts or images."""
