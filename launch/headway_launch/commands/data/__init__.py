"""`headway data`: create, describe, plot and validate scenarios of the bus environment."""

EXAMPLES = """\
examples:
  headway data synthetic towns/city --size city --seed 1
  headway data gtfs feed.zip towns/mine
  headway data csv counts towns/mine
  headway data transitgym SG_43_1 towns/sg43
  headway data sunt ../sunt_raw towns/salvador
  headway data describe towns/mine
  headway data plot towns/mine --output map.png
  headway data realism towns/mine
  headway run env=bus env.args.scenario=towns/mine algo=mappo

`headway data COMMAND --help` shows details.
"""
