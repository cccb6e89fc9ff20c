"""Azure: Table and Blob storage, Key Vault and Event Grid."""
