"""What the images show: outlines and leg axes, found, kept, corrected and tabulated."""
