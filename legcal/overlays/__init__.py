"""What detection found, drawn over the images and summed up, for people."""
