"""Image features for the searches: denoised images, response maps at many scales, edge responses."""
