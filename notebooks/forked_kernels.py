"""Kernels forked off a process that has imported already what takes each notebook 4 CPU seconds."""

import gc
import multiprocessing
import os
import signal
import time

os.environ.setdefault("MPLBACKEND", "module://matplotlib_inline.backend_inline")  # as kernels do
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(
    [
        "ipykernel.kernelapp",
        "scipy.signal",
        "f3amd_lib.training.pipeline",
        "f3amd_lib.drawing.pictures",
    ]
)


def _serve(arguments, environment, folder):
    """Be a kernel, as a process of its own that `ipykernel_launcher` started would be."""
    import jax
    from ipykernel.kernelapp import IPKernelApp

    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    # Read when JAX was imported; XLA reads its flags only now, before the first program.
    jax.config.update(
        "jax_disable_most_optimizations", bool(int(environment["JAX_DISABLE_MOST_OPTIMIZATIONS"]))
    )
    gc.set_threshold(100_000, 20, 50)  # tracing makes many small objects that are kept: as in tests
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # as nbval asks
    IPKernelApp.launch_instance(argv=[*arguments, f"--IPKernelApp.parent_handle={os.getppid()}"])


class Kernel:
    """As much of `subprocess.Popen` as a manager of kernels asks for."""

    stdin = stdout = stderr = None

    def __init__(self, command, *, env, cwd, **_):
        self.process = FORKS.Process(
            target=_serve, args=(command[command.index("-f") :], dict(env), str(cwd))
        )
        self.process.start()
        self.pid = self.process.pid
        while self.process.is_alive() and os.getpgid(self.pid) != self.pid:
            time.sleep(0.01)  # the manager will signal its group
        self.terminate, self.kill = self.process.terminate, self.process.kill

    def poll(self):
        return self.process.exitcode

    def wait(self):
        self.process.join()
        return self.process.exitcode

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)
