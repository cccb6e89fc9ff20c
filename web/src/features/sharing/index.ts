export { AccessList, goToAccess } from "./access-list";
export { MAY } from "./invite-form";
export { JoinForm } from "./join-form";
