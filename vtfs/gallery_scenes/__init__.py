"""The built-in scenes, a room each; `vtfs.gallery` makes them to a triangle count."""
