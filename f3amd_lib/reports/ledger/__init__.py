"""How the claims ledger comes to its verdicts: evidence, verdicts, and a rule for each claim."""
