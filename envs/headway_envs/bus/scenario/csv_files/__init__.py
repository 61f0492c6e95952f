"""Import of scenarios from an operator's own CSV files: timetable and link times or AVL calls, and counts."""
