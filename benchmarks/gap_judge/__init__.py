"""A second judge of `scarpsim gap`: folders of its own making with hidden truth, and a table of what was answered."""
