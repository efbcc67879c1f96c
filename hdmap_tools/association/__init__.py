"""From pixels to cells: which map cell each label of an image speaks about."""
