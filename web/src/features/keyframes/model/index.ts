export { readScript } from "./script-codec";
