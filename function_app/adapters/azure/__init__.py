"""Azure: Tables and Blob storage."""
