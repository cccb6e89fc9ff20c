"""Ways between agent and cloud. All carry the same messages; ``ports.transport`` says what each must do."""
