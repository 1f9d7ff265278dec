"""What the names of columns and variables say in laboratories of several languages."""

import re

_ROLES = {
    "time": r"t|time|times|zeit|temps|tiempo|time_?(axis|vector|stamp|s|sec)|x_?time",
    "rate": r"fs|f_s|fsamp|sr|rate|samp(le|ling)?_?(rate|freq(uency)?)(_?hz)?|abtastrate",
    "step": r"dt|delta_?t|d_t|sample_?(time|interval)|time_?step|wf_increment|ts|increment",
    "frequency": r"f|freq\w*|frequency\w*|frequenz\w*|fr[ée]quence\w*|hz|drive_?freq\w*|"
    r"excitation_?freq\w*|f_?exc|f_?hz|omega\w*|w|frf_?freq",
    "level": r"levels?|lvl|run|stufe|niveau|setpoint|block|sweep|entry|z_axis_value",
    "deviation": r"\w*(std|sigma|dev|deviation|uncert\w*)\w*",
    "phase": r"\w*pha(se|z)\w*|phi\w*|(\w*_)?ph|\w*_deg|theta\w*|arg\w*",
    "real": r"x|\w+[_. ](re|real|x)|re|real|(re|real)[_ ]\w+|in_?phase",
    "imaginary": r"y|\w+[_. ](im|imag|y)|im|imag|(im|imag)[_ ]\w+|quad\w*",
    "drive": r"\w*(drive|volt\w*|source|generator|amplifier|signal)\w*|v_?(in|out|exc)|u",
    "force": r"\w*(force|kraft|load_?cell|hammer|impedance_?head_?f)\w*|f_?n|fexc|f_?amp\w*|lc\w*",
    "coherence": r"\w*coh\w*",
    "velocity": r"\w*(velo\w*|vibrometer|ldv|geschw\w*)|v|vel\w*|\w*_m_s",
    "acceleration": r"\w*(acc\w*|beschl\w*)|a",
    "displacement": r"\w*(disp\w*|weg|laser|position)\w*|d|disp\w*",
    "amplitude": r"\w*(amp\w*|magn\w*|abs)|r|h|frf\w*|response\w*|xfer|transfer\w*",
}
_COMPILED = {role: re.compile(pattern, re.IGNORECASE) for role, pattern in _ROLES.items()}

_BASE = re.compile(
    r"(.*[^a-z])?(base|table|shaker|control|ctrl|foot|fixture|slip|basis|tisch|fu[sß]s?punkt|pot)"
    r"([^a-z].*)?",
    re.IGNORECASE,
)


def is_of_base(name: str) -> bool:
    """Whether a name says that something is of a moving base: a shaker's table, a control channel.

    >>> is_of_base("Control [g]"), is_of_base("table_acc"), is_of_base("tip")
    (True, True, False)
    """
    return bool(_BASE.fullmatch(name.strip()[:60]))


def role_of(name: str) -> str:
    """What a column is by its name, or nothing: "frequency", "force", "phase", "time", …

    A name may be a path ("data.freq") or have a unit behind it ("Freq [Hz]"): its last word counts.

    >>> role_of("data.Frequency [Hz]"), role_of("Kraft (N)"), role_of("fs"), role_of("qwe")
    ('frequency', 'force', 'rate', '')
    """
    last = re.sub(r"[\[(].*[\])]\s*$", "", name.strip()).strip().rsplit(".", 1)[-1]
    plain = re.sub(r"[\s\-]+", "_", last)[:60]
    if plain == "F":  # f is a frequency
        return "force"
    for role, pattern in _COMPILED.items():
        if pattern.fullmatch(plain):
            return role
    return ""
