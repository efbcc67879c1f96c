"""Training a network of labels: image and label pairs, augmentation, training, export."""
