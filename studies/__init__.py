"""Tables and pictures of the documentation, one file for each; no filter mathematics of its own."""

import subprocess


def head_commit():
    """Return the commit that a page is made from, in short, or ``unknown`` outside a checkout."""
    told = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    return told.stdout.strip() or "unknown"
