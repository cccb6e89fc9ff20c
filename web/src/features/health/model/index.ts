export { newestOf } from "./health";
