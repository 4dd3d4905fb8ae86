"""One refinement of a control cage."""
