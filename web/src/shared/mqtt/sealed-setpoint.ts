/**
 * Authenticates setpoints with the key of the lease, equal to device_agent/protocol/security/setpoints.py. WebCrypto is not
 * used: browsers provide it in secure contexts only, and it would make sending asynchronous.
 */
import { hmac } from "@noble/hashes/hmac.js";
import { sha256 } from "@noble/hashes/sha2.js";
import { bytesToHex, hexToBytes, utf8ToBytes } from "@noble/hashes/utils.js";
import type { Setpoint, Tagged } from "./protocol.generated";

/** Length of the tag: 16 bytes in hexadecimal. */
const TAG_DIGITS = 32;

/** The message for `topic`. Its JSON contains the setpoint exactly as it was authenticated. */
export function sealed(setpoint: Setpoint, key: string, topic: string): Tagged {
  const text = `telescope/v1/setpoint\n${topic}\n${JSON.stringify(setpoint)}`;
  const tag = bytesToHex(hmac(sha256, hexToBytes(key), utf8ToBytes(text))).slice(0, TAG_DIGITS);
  return { tag, body: setpoint };
}
