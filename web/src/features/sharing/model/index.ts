export { FollowedInvitation, type TabStorage } from "./invitation-link";
