"""What an image's label ids mean, and which class of the map each of them is."""
