"""Components in their places, and how they advance over a block."""
