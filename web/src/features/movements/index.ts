export { MovementsCard } from "./movements-card";
