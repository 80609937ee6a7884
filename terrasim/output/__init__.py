"""Things to look at: pictures, USD stages, reports."""
