export { Fleet } from "./device-list";
export { DeviceSession } from "./device-session";
export { DeviceStore, type OpenRequestHere, type Reach } from "./device-store";
