"""Runs a command as other processors would: `python -m tests.processors plain pytest tests/safety`.

Compilers and libraries choose their code by what the processor offers, and round otherwise in each. They are told here
that it offers less. Each setting names what the processor has:

    own    all that this one has
    older  no wider vectors than those of the year 2013 (AVX2)
    plain  nothing but what each of its architecture has
    mixed  all for compiled functions, nothing for numpy, another for linear algebra: no processor, but another rounding
"""

import os
import platform
import sys

from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__

OF_LIBRARIES = ("NVPL_BLAS_DEBUG_CPU_TYPE", "OPENBLAS_CORETYPE")  # which some machines set by themselves


def environment(setting: str) -> dict[str, str]:
    """Return the variables of a setting.

    Raises:
        KeyError: there is no such setting.
    """
    x86 = platform.machine().lower() in ("x86_64", "amd64")
    # numpy refuses names that it was not built to choose by, and warns of those that the processor does not offer.
    dispatched = [name for name in __cpu_dispatch__ if __cpu_features__[name]]
    numpy_plain = {"NPY_DISABLE_CPU_FEATURES": " ".join(dispatched)}
    # glibc's sines and logarithms; other C libraries do not know the variable.
    libm_plain = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-FMA4,-AVX2"} if x86 else {}
    torch_plain = {"ATEN_CPU_CAPABILITY": "default", "MKL_CBWR": "COMPATIBLE", "ONEDNN_MAX_CPU_ISA": "SSE41"}
    plain = {
        "NUMBA_CPU_NAME": "generic", "OPENBLAS_CORETYPE": "Prescott" if x86 else "ARMV8",
        **numpy_plain, **libm_plain, **torch_plain,
    }  # fmt: skip
    older = {
        "NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx,+avx2,+fma", "OPENBLAS_CORETYPE": "Haswell",
        "NPY_DISABLE_CPU_FEATURES": " ".join(name for name in dispatched if "V4" in name or "512" in name),
        "ATEN_CPU_CAPABILITY": "avx2", "MKL_CBWR": "AVX2", "ONEDNN_MAX_CPU_ISA": "AVX2",
    } if x86 else {"NUMBA_CPU_NAME": "generic", "OPENBLAS_CORETYPE": "CORTEXA57"}  # fmt: skip
    mixed = {**numpy_plain, **libm_plain, "OPENBLAS_CORETYPE": "Sandybridge" if x86 else "NEOVERSEN1"}
    return {"own": {}, "older": older, "plain": plain, "mixed": mixed}[setting]


if __name__ == "__main__":
    setting, program, *arguments = sys.argv[1:]
    inherited = {name: value for name, value in os.environ.items() if name not in OF_LIBRARIES}
    os.execvpe(program, [program, *arguments], inherited | environment(setting))
