"""Where shadow and culling methods fail: ladders of ever harder cases, every method on each, against float64."""
