"""Generated documents: the AsyncAPI description and the script API."""
