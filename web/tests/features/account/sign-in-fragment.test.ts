import { describe, expect, it } from "vitest";
import { signInFailure, signInToken } from "../../../src/features/account/model/session";

describe("sign-in fragments", () => {
  it("why signing in elsewhere failed is a code, and nothing else", () => {
    expect(signInFailure("#sign-in-failed=oidc-expired")).toBe("oidc-expired");
    for (const hash of ["", "#/", "#sign-in-failed=", "#sign-in-failed=<b>"]) expect(signInFailure(hash)).toBeNull();
  });

  it("a sign-in token is taken from its own fragment only", () => {
    expect(signInToken("#sign-in=abc-_%2B")).toBe("abc-_+");
    for (const hash of ["", "#/", "#sign-in=", "#x&sign-in=abc", "#sign-in=%"]) expect(signInToken(hash)).toBeNull();
  });
});
