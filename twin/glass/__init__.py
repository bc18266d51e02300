"""Both lens paths in glass: prescriptions, tracing, as-built errors, and what they do to the image."""
