export { FollowedInvitation, type Shelf } from "./invitation-link";
