"""Fig. 6: shallow and deep tangent networks at the corners of polygons."""
