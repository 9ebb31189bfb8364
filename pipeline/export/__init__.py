"""Results in the forms that others take: pictures, animations, glTF, YOLO sets, packages with checksums."""
