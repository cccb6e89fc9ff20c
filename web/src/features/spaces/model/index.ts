export type { Values } from "./room-perception";
