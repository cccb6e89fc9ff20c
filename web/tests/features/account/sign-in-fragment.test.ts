import { describe, expect, it } from "vitest";
import { signInFailure, signInToken } from "../../../src/features/account/model/session";

describe("sign-in fragments", () => {
  it("reads only well-formed error codes of an external sign-in", () => {
    expect(signInFailure("#sign-in-failed=oidc-expired")).toBe("oidc-expired");
    for (const hash of ["", "#/", "#sign-in-failed=", "#sign-in-failed=<b>"]) expect(signInFailure(hash)).toBeNull();
  });

  it("reads a sign-in token from its own fragment only", () => {
    expect(signInToken("#sign-in=abc-_%2B")).toBe("abc-_+");
    for (const hash of ["", "#/", "#sign-in=", "#x&sign-in=abc", "#sign-in=%"]) expect(signInToken(hash)).toBeNull();
  });
});
