"""Tables and pictures of the documentation, one file for each; no filter mathematics of its own."""
