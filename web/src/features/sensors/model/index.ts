export { type Quantity, quantityOf } from "./quantities";
export { Recording } from "./stored-series";
