"""The shape of surfaces: edges, symmetries, axes of revolution, centroids."""
