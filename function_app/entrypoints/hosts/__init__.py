"""Programs that host the functions: AWS Lambda, Azure Functions, uvicorn, and the local worker."""
