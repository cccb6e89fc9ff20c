export { AccessList, goToAccess } from "./access-list";
export { SHARED_ROLES } from "./invite-form";
export { JoinForm } from "./join-form";
