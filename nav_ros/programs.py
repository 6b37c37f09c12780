"""Where the programs begin: what they import takes a second or two, in which Ctrl-C ends them without a traceback."""

import importlib
import signal


def program(module, name="main"):
    """Return what imports a module and calls a function of it; it is named by texts, because it stands above this."""
    def run():
        handler = signal.getsignal(signal.SIGINT)
        if handler is signal.default_int_handler:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
        main = getattr(importlib.import_module(module), name)
        signal.signal(signal.SIGINT, handler)
        return main()
    return run


attitude_node = program("attitude_estimator.node")
alignment_node = program("alignment.node")
navigation_node = program("attitude_estimator.navigation.node")
replay_node = program("nav_ros.replay_node")
estimate_bag = program("attitude_estimator.cli")
align_bag = program("alignment.cli")
navigate_bag = program("attitude_estimator.navigation.cli")
simulate_bag = program("nav_ros.cli", "simulate_bag_main")
score_bag = program("nav_ros.cli", "score_bag_main")
report_bag = program("nav_ros.report_cli")
allan = program("nav_ros.allan_cli")
attitude_demo = program("nav_ros.demo")
