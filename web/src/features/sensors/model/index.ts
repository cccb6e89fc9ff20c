export { type Quantity, quantityOf } from "./quantities";
export { RoomDeviceAction } from "./room-device-action";
export { Recording } from "./stored-series";
