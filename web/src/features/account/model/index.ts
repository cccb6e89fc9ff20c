export { Session } from "./session";
