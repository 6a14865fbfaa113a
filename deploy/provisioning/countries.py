"""The countries that a radio can be told: ISO 3166-1 alpha-2, as the kernel's rules name them.

A code that the kernel does not know leaves the radio on the world's common denominator without a
word: the network on channel 13 is then never found. So a code that does not exist is refused.
"""

from deploy.errors import DeployError

_TABLE = """
    AD AE AF AG AI AL AM AO AQ AR AS AT AU AW AX AZ BA BB BD BE BF BG BH BI BJ BL BM BN BO BQ BR BS
    BT BV BW BY BZ CA CC CD CF CG CH CI CK CL CM CN CO CR CU CV CW CX CY CZ DE DJ DK DM DO DZ EC EE
    EG EH ER ES ET FI FJ FK FM FO FR GA GB GD GE GF GG GH GI GL GM GN GP GQ GR GS GT GU GW GY HK HM
    HN HR HT HU ID IE IL IM IN IO IQ IR IS IT JE JM JO JP KE KG KH KI KM KN KP KR KW KY KZ LA LB LC
    LI LK LR LS LT LU LV LY MA MC MD ME MF MG MH MK ML MM MN MO MP MQ MR MS MT MU MV MW MX MY MZ NA
    NC NE NF NG NI NL NO NP NR NU NZ OM PA PE PF PG PH PK PL PM PN PR PS PT PW PY QA RE RO RS RU RW
    SA SB SC SD SE SG SH SI SJ SK SL SM SN SO SR SS ST SV SX SY SZ TC TD TF TG TH TJ TK TL TM TN TO
    TR TT TV TW TZ UA UG UM US UY UZ VA VC VE VG VI VN VU WF WS YE YT ZA ZM ZW
"""
CODES = frozenset(_TABLE.split())
_OFTEN_MEANT = {"UK": "GB", "EN": "GB", "EL": "GR"}


def check_country(code: str) -> str:
    """Returns the code; raises `DeployError` when it is no country's."""
    if code in CODES:
        return code
    capitals = code.upper()
    meant = capitals if capitals in CODES else _OFTEN_MEANT.get(capitals)
    hint = f" (is it {meant}?)" if meant else ""
    raise DeployError(
        f"'wifi.country' is {code[:20]!r}; expected the two capital letters of ISO 3166, as DE or"
        f" US{hint}"
    )
