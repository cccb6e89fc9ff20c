"""How the functions are reached: HTTP, messages, timers; on this machine and on the clouds' hosts."""
