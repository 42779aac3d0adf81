"""Features of images, with their matches: found, or given in a database."""
