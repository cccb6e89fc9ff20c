"""One machine or one site: SQLite, files, and a broker of our own."""
