// Loaded before Azurite: exits when the process that started it exits.
process.stdin.on("end", () => process.exit()).resume();
