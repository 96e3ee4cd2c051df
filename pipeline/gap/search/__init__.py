"""The effects tried: screened, refitted, grown into hypotheses and held against each other."""
