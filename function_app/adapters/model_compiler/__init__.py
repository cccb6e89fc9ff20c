"""The model compiler: MuJoCo in a sandboxed child process."""
