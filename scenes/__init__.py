"""What lies under the lenses: board, coin, ball grid array, diaphragm, plane and mesh files, in mm."""
