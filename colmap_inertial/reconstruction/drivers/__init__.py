"""What a command does from beginning to end, and what it leaves behind."""
