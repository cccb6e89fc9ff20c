/** A new id of the contract: 32 random hexadecimal digits. */
export function newId(): string {
  // Not `crypto.randomUUID`: it requires a secure origin, and Stop must work on every origin.
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  return Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
}
