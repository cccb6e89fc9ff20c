export { simplify } from "./recording";
export { MAX_SCRIPT_LENGTH, readScript } from "./script-codec";
