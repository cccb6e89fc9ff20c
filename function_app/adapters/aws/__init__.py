"""Amazon: DynamoDB and S3."""
