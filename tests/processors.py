"""Runs a command with the rounding of other processors: `python -m tests.processors plain pytest tests/safety`.

Compilers and libraries choose code by the features of the processor, and each choice rounds differently. Here they are
told that it has fewer features:

    own    all features of this processor
    older  no vectors wider than those of 2013 (AVX2)
    plain  only the features that all processors of this architecture have
    mixed  all features for compiled functions, none for numpy, others for linear algebra: like no real processor
"""

import os
import platform
import sys

from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__


def settings() -> dict[str, dict[str, str]]:
    """Return the environment variables of each setting; call it in a process that was started without any of them."""
    # numpy refuses features that it does not choose code by, and warns of those that the processor lacks.
    dispatched = [name for name in __cpu_dispatch__ if __cpu_features__[name]]
    plain = {
        "NUMBA_CPU_NAME": "generic", "NPY_DISABLE_CPU_FEATURES": " ".join(dispatched),
        "OPENBLAS_CORETYPE": "ARMV8", "ATEN_CPU_CAPABILITY": "default",
    }  # fmt: skip
    if platform.machine().lower() not in ("x86_64", "amd64"):
        older = plain | {"NPY_DISABLE_CPU_FEATURES": "", "OPENBLAS_CORETYPE": "CORTEXA57"}
        mixed = plain | {"NUMBA_CPU_NAME": "", "OPENBLAS_CORETYPE": "NEOVERSEN1"}
    else:
        plain |= {
            "OPENBLAS_CORETYPE": "Prescott", "MKL_CBWR": "COMPATIBLE", "ONEDNN_MAX_CPU_ISA": "SSE41",
            "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-FMA4,-AVX2",  # for sines and logarithms
        }  # fmt: skip
        mixed = plain | {"NUMBA_CPU_NAME": "", "OPENBLAS_CORETYPE": "Sandybridge"}
        older = {
            "NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx,+avx2,+fma", "OPENBLAS_CORETYPE": "Haswell",
            "NPY_DISABLE_CPU_FEATURES": " ".join(name for name in dispatched if "V4" in name or "512" in name),
            "ATEN_CPU_CAPABILITY": "avx2", "MKL_CBWR": "AVX2", "ONEDNN_MAX_CPU_ISA": "AVX2",
        }  # fmt: skip
    each = {"own": {}, "older": older, "plain": plain, "mixed": mixed}
    return {name: {key: value for key, value in chosen.items() if value} for name, chosen in each.items()}


def unset(variables: dict[str, str]) -> dict[str, str]:
    """Return variables without those of settings; some machines set a few of those by themselves."""
    names = {"NVPL_BLAS_DEBUG_CPU_TYPE", *(name for chosen in settings().values() for name in chosen)}
    return {name: value for name, value in variables.items() if name not in names}


if __name__ == "__main__":
    setting, program, *arguments = sys.argv[1:]
    os.execvpe(program, [program, *arguments], unset(dict(os.environ)) | settings()[setting])
