"""Configuration records and how mappings become them."""
