"""The shapes that stamps have, one family a file."""
