"""AWS: DynamoDB, S3, Secrets Manager and IoT Core."""
