"""A terrain in one SQLite file: packed blocks of every level, and the streamed build."""
