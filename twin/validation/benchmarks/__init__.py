"""How long the costly steps take, beside what others need for the same: the table that `greenough bench` prints."""
