"""What searches make of a picture: response maps at all scales, edge responses, a picture without noise."""
