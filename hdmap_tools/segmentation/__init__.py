"""From images to label images."""
