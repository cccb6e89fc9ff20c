// Loaded before Azurite: it ends when whoever started it does, even without a word.
process.stdin.on("end", () => process.exit()).resume();
