import { describe, expect, it } from "vitest";
import { FollowedCode, pairingCode, readCode } from "../../../src/features/pairing/model/claim-code";
import { FakeStorage } from "../../support/fake-storage";

describe("a claim code", () => {
  it.each(["BCDF-GHJK", "bcdfghjk", " bcdf ghjk ", "BCDF–GHJK"])("is accepted in different spellings: %s", (typed) => {
    expect(readCode(typed)).toBe("BCDF-GHJK");
  });

  it.each(["", "BCDF-GHJ", "BCDF-GHJKL", "ABCD-EFGH", "BCDF-GH1K"])("is invalid: %s", (typed) => {
    expect(readCode(typed)).toBeNull();
  });

  it("is read from the fragment of a link, but not from similar fragments", () => {
    expect(pairingCode("#pair=BCDF-GHJK")).toBe("BCDF-GHJK");
    expect(pairingCode("#pair=bcdfghjk")).toBe("BCDF-GHJK");
    for (const hash of ["", "#/", "#pair=", "#pair=BCDF-GHJK&x=1", "#pair=<b>BCDFGHJK", "#x#pair=BCDF-GHJK"]) {
      expect(pairingCode(hash)).toBeNull();
    }
  });

  it("of a followed link survives an external sign-in, until it is used", () => {
    const storage = new FakeStorage();
    new FollowedCode(storage).follow("BCDF-GHJK");
    const reloaded = new FollowedCode(storage);
    expect(reloaded.code.value).toBe("BCDF-GHJK");
    reloaded.drop();
    expect(new FollowedCode(storage).code.value).toBeNull();
  });
});
