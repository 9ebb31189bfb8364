"""Draw definitions, pages and messages for readers to grade, and write the page of their grades."""
